"""Parse the commands, run them, and show their results and exit statuses.

`options` makes parsers from the functions in `commands`, `command` runs them, the others print. Nothing
but `__main__`, `solve` and `reference` may import this folder; it reaches plans by the api alone.
"""
