"""Forces given by functions, for engines that have none of their own."""
