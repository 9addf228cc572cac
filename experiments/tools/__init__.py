"""The bench and the doctor."""
