"""The goal node: checks and numbers goals, and decides when they end."""
