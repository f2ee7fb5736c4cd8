"""Run the cases of a study, in processes or on a cluster, and keep one row for each case.

`study` reads, `axes` makes the cases, `run` keeps their rows, `outcome` sums up, `page` shows. The
api and the commands may import this folder; the work on a case is a function that they give it.
"""
