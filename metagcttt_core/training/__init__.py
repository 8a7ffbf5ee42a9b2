"""Gradient steps, optimisers, checkpoints and pre-training."""
