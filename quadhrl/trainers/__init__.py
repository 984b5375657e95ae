"""Training with TorchRL's PPO."""
