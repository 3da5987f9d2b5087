"""A second simulator, for evaluation alone: other propagation, other ships, another sea than the twin that trains.

Nothing here is read by training, and nothing of `obsnet.twin` is read here.
"""
