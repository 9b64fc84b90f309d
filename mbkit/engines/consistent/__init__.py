"""States and jumps of the velocity that constraints allow."""
