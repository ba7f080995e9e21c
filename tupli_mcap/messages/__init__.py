"""Gymnasium spaces and values as ROS 2 messages, NumPy dtypes and CDR bytes."""
