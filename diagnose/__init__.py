"""Measured joint data against a simulated asset: what differs, and why."""
