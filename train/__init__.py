"""Training and evaluation of policies on the registered environments."""
