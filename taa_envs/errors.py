"""Errors a user of the package can meet; each message says what is wrong and what to do."""


class TaaEnvsError(Exception):
    """Base of the errors that the package raises on purpose."""


class AssetError(TaaEnvsError):
    """An asset folder, or what was to become one, is not valid."""


class GateFailed(AssetError):
    """The body is valid and does not behave: it falls through itself, does not come to rest, or weighs tons."""


class AssetExists(AssetError):
    """There is an asset of that id already."""


class UnknownAsset(TaaEnvsError, LookupError):
    """No asset has that id; the message lists the ids there are."""


class UnknownHand(TaaEnvsError, LookupError):
    """No hand has that name; the message lists the names there are."""


class HandUnavailable(TaaEnvsError):
    """A robot hand's model is not on this machine and cannot be fetched."""
