"""Makes a scene clean, proven by the exact audit, with little movement and its relations preserved."""

from models.physics_corrector.certify.certifier import Certifier, certify
from models.physics_corrector.certify.options import CertificationResult, CertifyOptions, CorrectionStatus, DroppedObject

__all__ = ["CertificationResult", "Certifier", "CertifyOptions", "CorrectionStatus", "DroppedObject", "certify"]
