"""How the risk that was asked for is shared out."""
