"""What advances an arm: one file or folder a back end."""
