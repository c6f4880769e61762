"""Virtual experiments: MuJoCo, an independent engine, simulates the robot and implements the effects itself."""
