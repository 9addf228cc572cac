"""Controllers of the arm and its gripper."""
