"""From tracks to a joint: articulated structure from motion."""
