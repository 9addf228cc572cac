"""One run: settings, host loop, worker, files."""
