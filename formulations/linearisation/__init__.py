"""Mean and covariance factor around an iterate, as affine functions of the burns.

`dynamics` flies the grid, `linearisation` and `factor` differentiate mean and factor, `shifts` by times
and phases. Rows, programs and `scp_recon` may import this folder; it imports `problem` and `arrays`.
"""
