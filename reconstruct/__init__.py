"""Video -> articulated, simulation-ready asset."""
