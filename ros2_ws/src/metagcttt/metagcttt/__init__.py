"""ROS 2 nodes around the metagcttt library and its simulators."""

import os

# Without this a NumPy scalar in a message field is published as garbage, silently. Generated
# message code reads it when it is imported, hence before everything else.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
