"""Makes a scene exactly clean, proven by the exact audit, moving little and keeping relations."""

from models.physics_corrector.certify.certifier import Certifier, certify
from models.physics_corrector.certify.options import Certified, CertifyOptions, Dropped, Status

__all__ = ["Certified", "Certifier", "CertifyOptions", "Dropped", "Status", "certify"]
