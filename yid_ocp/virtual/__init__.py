"""Virtual experiments in MuJoCo, an independent engine that simulates the robot and implements the effects itself."""
