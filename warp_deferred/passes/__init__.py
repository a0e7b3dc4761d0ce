"""Passes: what each stage reads, writes and when it is called for."""
