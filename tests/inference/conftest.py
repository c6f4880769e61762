"""The pendulum whose motion is known and whose joint efforts are measured."""

from pendulum_bench import bench as bench
