"""Draw figures and tables from the results of `experiments`.

`inputs` reads plans and tables, `flight` and `studies` draw them with `drawing`. Tests alone may import
this folder; it imports `scp_recon`.
"""
