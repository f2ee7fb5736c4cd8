"""Fly a plan many times with errors, and summarise the flights.

`sampling` draws and flies, `whole_flight` judges by `limits`, `strata` saves flights, `summary` is
the file. Verification, certification and everything above them may import this folder; it imports
`results`.
"""
