"""Figures and tables from the results of `experiments`; each module is one."""
