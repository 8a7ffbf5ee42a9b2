"""ROS 2 nodes around the metagcttt library and its simulators."""

import os

# Without this a NumPy scalar in a message field is silently published as garbage. The generated
# message code reads it at import, hence before everything else.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
