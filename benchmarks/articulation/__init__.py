"""How well a joint is found from point tracks, against known truth and against the Cramer-Rao bound.

``python -m benchmarks.articulation`` runs it; ``docs/benchmarks/articulation.md`` shows and explains its tables.
"""
