"""Errors that a user can act on; each has the exit code of the command that ends with it."""


class HorizonError(Exception):
    """Base of the errors whose message alone tells what to do; entry points print it without a traceback."""

    exit_code = 1


class ConfigError(HorizonError):
    """A setting, or a combination of settings, that cannot work."""

    exit_code = 3


def require_least(config: object, key: str, least: dict[str, float], hint: str = "") -> None:
    """Raise ConfigError, naming `key`.field, for the first field of a settings object below its least; null passes."""
    for name, low in least.items():
        value = getattr(config, name)
        if value is not None and value != value:
            raise ConfigError(f"{key}.{name} must be a finite number, but got {value}")
        if value is not None and value < low:
            raise ConfigError(f"{key}.{name}={value}: must be at least {low}{hint}")


class BusyError(ConfigError):
    """Another process works in the folder of a run."""


class CheckpointError(HorizonError):
    """A weights or checkpoint file that is missing, broken or of another model."""

    exit_code = 3


class DataError(HorizonError):
    """A data file, table or calibration that is missing, broken or contradicts another."""

    exit_code = 4


class DivergedError(HorizonError):
    """Training produced a loss that is not a finite number."""

    exit_code = 5


class InterruptedRunError(HorizonError):
    """The run was stopped from outside after a checkpoint; the same command resumes it."""

    exit_code = 6
