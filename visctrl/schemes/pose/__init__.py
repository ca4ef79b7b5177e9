"""EKF pose estimation and Cartesian tracking control (chapter 4 of the source)."""
