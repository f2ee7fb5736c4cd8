"""Run the cases of a study, in processes or on a cluster, and keep one row for each case."""
