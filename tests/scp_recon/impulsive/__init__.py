"""Tests of problems by hand."""
