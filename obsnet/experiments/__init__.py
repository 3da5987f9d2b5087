"""The papers' own experiments, on simulated data, with obsnet's number beside the paper's."""
