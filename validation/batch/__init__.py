"""Many runs on many processors, each kept on disk as soon as it is finished."""

from pdvc_bench import check_extra

check_extra("many", "dask", "distributed", "pandas", "pyarrow")
