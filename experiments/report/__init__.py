"""Tables, figures and films, from result files."""
