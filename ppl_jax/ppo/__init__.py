"""PPO-Lagrangian, which trains the neural experts."""
