"""Many runs on many processors, each kept on disk as soon as it is finished."""
