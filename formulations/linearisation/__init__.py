"""Mean and covariance factor around an iterate, as affine functions of the burns."""
