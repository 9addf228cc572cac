"""Back ends that advance an arm, a file or folder each."""
