"""What every record of `history/` tells of where it was made."""

from benchmarks.records import PACKAGES, circumstances, versions_of


def pytest_benchmark_update_machine_info(config, machine_info):
    """Only what makes records comparable: neither a host's name nor hundreds of flags."""
    machine_info.pop("node", None)
    machine_info["cpu"] = machine_info["cpu"].get("brand_raw")
    machine_info["versions"] = versions_of(*PACKAGES)


def pytest_benchmark_update_json(config, benchmarks, output_json):
    """Load, too, which is never the same."""
    output_json["circumstances"] = circumstances()
