"""The state constraints of P3 and of P2 as second-order cones in the burns.

`uniform` has rows of facets, `exact` and `exact_flight` of probabilities, `drift` of free flights.
Programs, `nlp` and `scp_recon` may import this folder; it imports `linearisation` and below.
"""
