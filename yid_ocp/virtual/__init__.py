"""Virtual experiments: another engine (MuJoCo) plays the robot, with effects done in its own terms."""
