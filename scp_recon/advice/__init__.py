"""Find what would help a user's command: values with which a failed plan ends verified, and savings.

`infeasibility` diagnoses and chooses other values, `trials` carries out the command with these, `clock`
limits the time. The commands alone import this folder; it plans by the api.
"""
