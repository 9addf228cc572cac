"""A scene of your own on MJX: its MJCF, its task and its expert."""
