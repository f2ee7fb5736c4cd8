"""Store plans: facts, figures computed from them, the file, tables and comparisons.

`facts` are what a file states, with the record in `verification`; `figures` are what follows from them.
Flights, reports and everything above them may import this folder; it imports `planning`.
"""
