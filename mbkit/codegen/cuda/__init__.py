"""The same programs on an NVIDIA GPU, in double precision, through the driver alone."""
