"""Many flights with errors: sampled, tallied and summarised."""
