"""A page that shows a test while it runs, made from its record and its pictures alone."""

from pdvc_bench import check_extra

check_extra("live", "tornado")
