// Kernels of the identity encoder.
#pragma once

#include "plugin/row_encoder.h"

namespace semfield {

struct IdentityShape {};

void identity_kernels(KernelTables& tables);

}  // namespace semfield
