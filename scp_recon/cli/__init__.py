"""What the commands share: how they end, their options, and the tables that they print."""
