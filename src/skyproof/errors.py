"""The errors skyproof raises for a caller to read: what was expected, what came, what to do."""


class SkyproofError(Exception):
    """Base of every error that is meant for a user.

    The command line prints it as one sentence and exits with code 2.
    """


class ConfigurationError(SkyproofError):
    """A setting, or a combination of settings, that cannot work."""


class DetectorAnswerError(SkyproofError):
    """A detector from elsewhere that did not answer, or whose answer is invalid."""


class ImageryError(SkyproofError):
    """An image that is missing, unreadable, without ground resolution, too coarse or too small."""


class NotFiniteError(SkyproofError):
    """Numbers that are not finite (NaN, infinity) where they are stored, read or drawn."""


class StoredFileError(SkyproofError):
    """A file or folder of ours that is missing, damaged or written by another version."""


class RunFolderError(SkyproofError):
    """An output folder that holds something else, or a disk that cannot take the output."""


def is_full_memory(error: BaseException) -> bool:
    """Tells whether main memory is full, for which torch has no error class."""
    words = ("can't allocate memory", "you tried to allocate")
    return isinstance(error, MemoryError) or any(each in str(error) for each in words)
