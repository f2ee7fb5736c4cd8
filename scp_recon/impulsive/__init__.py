"""Plan and fly impulsive transfers of any flow, stated by arrays instead of a scenario.

`problem` states and plans with `regions`, `plan` holds the result and flies it. Only `import scp_recon`
and studies import this folder; it imports `certification`, `planning` and below, and knows no asteroid.
"""
