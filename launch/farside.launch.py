"""Launch file for a ROS 2 workspace: `ros2 launch launch/farside.launch.py config:=launch/live.yaml`.

The node is a separate program that connects to ROS 2 over Zenoh. Set RMW_IMPLEMENTATION=rmw_zenoh_cpp for the other
nodes and start their router (`ros2 run rmw_zenoh_cpp rmw_zenohd`). `farside` must be on PATH; else give `program:=`.
"""

import shlex

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription


def _node(context):
    program, config, arguments = (
        LaunchConfiguration(name).perform(context) for name in ("program", "config", "arguments")
    )
    command = [program, "live", "--config", config, *shlex.split(arguments)]
    return [ExecuteProcess(cmd=command, name="farside", output="screen", sigterm_timeout="10")]


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", description="configuration file, such as launch/live.yaml"),
            DeclareLaunchArgument("program", default_value="farside", description="the command"),
            DeclareLaunchArgument("arguments", default_value="", description="further options of `farside live`"),
            OpaqueFunction(function=_node),
        ]
    )
