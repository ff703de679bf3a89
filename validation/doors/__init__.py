"""Files of other programs: scans read into an experiment, measurements and geometries written for others to read.

A scan is read as a `validation.doors.scan.Scan`, whatever its format, and two of them become an experiment folder
(`validation.doors.assembly`). Nothing of the measurement knows these formats: `pdvc` reads its own folder alone.
"""
