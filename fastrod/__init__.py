"""fastrod: tendon-driven continuum robots, simulated in batches and corrected by measured data."""

from fastrod.robot import Robot, Segment, Tendon
from fastrod.robotfile import load_robot, robot_names, save_robot
from fastrod.simulator import Observer, Pose, Simulator, State

__all__ = ["Observer", "Pose", "Robot", "Segment", "Simulator", "State", "Tendon", "load_robot", "robot_names", "save_robot"]
