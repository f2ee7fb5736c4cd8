"""Store plans: facts, figures computed from them, the file, tables and comparisons.

`facts` are what a file states, `figures` what follows; `verification` compares the two.
Flights, reports and everything above them may import this folder; it imports `planning`.
"""
