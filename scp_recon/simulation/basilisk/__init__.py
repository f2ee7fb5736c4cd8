"""The spacecraft on Basilisk, the extra [sim]."""
