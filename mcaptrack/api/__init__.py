"""The library: functions for everything that the command line does; ``mcaptrack/__init__.py`` exports them.

They are typed, return results, raise McaptrackError, and never print. Warnings are Python warnings of class
McaptrackWarning and also stand in the results. Routine notes go to the logger "mcaptrack".
"""
