"""Print each force transducer's peak in one second, with its calibration from the amplifier."""

from drivers.examples import run_example
from drivers.instruments.force.driver import Force


def main(url: str = "zenoh:127.0.0.1:7462", seconds: float = 1.0) -> dict[str, tuple[float, float]]:
    """Read once, and print the largest compression of each transducer."""
    with Force.open(url) as force:
        force.start()
        samples = force.read(round(seconds * force.datasheet.rate_hz), timeout_s=seconds + 5.0)
        peaks = force.peaks(samples)
        for channel in force.datasheet.channels:
            value, time_s = peaks[channel.name]
            scale = f"{1e3 * channel.sensitivity_v:g} mV/{channel.unit}, {channel.kind}"
            print(f"{channel.name}: {value:.2f} {channel.unit} at {time_s:.4f} s ({scale})")
        return peaks


if __name__ == "__main__":
    run_example(main)
