"""The paper's own figures and tables."""
