"""Makes a scene exactly clean, proven by the exact audit, moving little and keeping relations."""

from models.physics_corrector.certify.certifier import Certifier, certify
from models.physics_corrector.certify.options import CertificationResult, CertifyOptions, CorrectionStatus, DroppedObject

__all__ = ["CertificationResult", "Certifier", "CertifyOptions", "CorrectionStatus", "DroppedObject", "certify"]
