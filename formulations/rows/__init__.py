"""The state constraints of P3 and of P2 as second-order cones in the burns."""
