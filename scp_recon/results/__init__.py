"""Store, read, compare and tabulate plans, and manage the folders of runs."""
