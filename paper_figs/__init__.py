"""Draw figures and tables from the results of `experiments`."""
