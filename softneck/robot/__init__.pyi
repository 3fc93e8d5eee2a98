from ._robot import Robot as Robot
from ._search import find_robot as find_robot
