# shellcheck shell=sh
# What the setup files of ROS 2 Jazzy from apt set, for the wheels in its place.
_prefix=/opt/ros/jazzy
export ROS_VERSION=2 ROS_PYTHON_VERSION=3 ROS_DISTRO=jazzy
export AMENT_PREFIX_PATH="$_prefix${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}"
export CMAKE_PREFIX_PATH="$_prefix${CMAKE_PREFIX_PATH:+:$CMAKE_PREFIX_PATH}"
export LD_LIBRARY_PATH="$_prefix/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
export PATH="$_prefix/bin:$PATH"
for _packages in "$_prefix"/lib/python3.*/site-packages; do
  export PYTHONPATH="$_packages${PYTHONPATH:+:$PYTHONPATH}"
done
unset _prefix _packages
