"""What is done with a case, and how all cases come to rows."""
