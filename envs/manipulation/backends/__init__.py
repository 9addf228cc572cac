"""Back ends of the arm tasks: each advances the physics of a control step, and senses.

The task, its observation, reward and expert are one code over all of them.
"""
