"""The scripted experts of the tasks."""
