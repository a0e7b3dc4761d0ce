"""Benches: frozen cases, device times from graph replays, results as JSON, tables and plots made from them.

Run from the repository's root: `python -m bench triangles --device cuda:0 --json bench/results/triangles.json`.
"""
