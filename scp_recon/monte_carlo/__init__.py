"""Monte Carlo flights with errors: sampled, tallied and summarised."""
