"""The hand in space: where it is, which hand drives the part, what that says about scale, and the demonstration."""
