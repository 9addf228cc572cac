"""A manipulation scene of your own in three files: scene, task and expert."""
