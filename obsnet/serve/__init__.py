"""A folder of ``obsnet track`` or ``obsnet watch`` in, a page for people out: ``obsnet serve``. Read-only."""
