"""Campaigns: the cases of a study, run here, on processes or on a cluster, with one row each."""
