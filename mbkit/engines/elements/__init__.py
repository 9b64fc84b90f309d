"""Force elements, for engines that have none of their own."""
