"""Three views: the 1D and 2D trifocal tensors of planar motion, their solvers and refinement."""
