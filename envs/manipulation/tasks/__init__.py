"""The tasks: state, reward, success, observation, starts."""
