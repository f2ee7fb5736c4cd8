"""Find what would help a user's command: values with which a failed plan ends verified, and savings.

`infeasibility` diagnoses; `trials` carries out the command with other values, which `repairs` chooses
for plans whose checks fail; `clock` limits the time.
The commands alone import this folder; it plans by the api.
"""
