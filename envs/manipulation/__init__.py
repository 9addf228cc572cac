"""UR5e table wiping and nut assembly, in MJX and in C MuJoCo."""
