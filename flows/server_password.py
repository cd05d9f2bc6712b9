"""A password for the Prefect server and its clients on this machine: python -m flows.server_password > .env."""

import secrets

NAMES = ("PREFECT_SERVER_API_AUTH_STRING", "PREFECT_API_AUTH_STRING")  # the server's, and everyone else's


def environment() -> str:
    """Return the lines of a .env file with a new random password."""
    user_and_password = f"hnerf:{secrets.token_urlsafe(24)}"
    return "".join(f"{name}={user_and_password}\n" for name in NAMES)


if __name__ == "__main__":
    print(environment(), end="")
