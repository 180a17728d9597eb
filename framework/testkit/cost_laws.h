// Laws of what a component says that it costs: scratch memory and matrix products.
#pragma once

#include <cstddef>
#include <string>

#include "plugin/field.h"
#include "testkit/failures.h"
#include "testkit/laws.h"

namespace semfield::testkit {

/// What a component says that it takes of a workspace may be that much more than what a large batch takes.
constexpr std::size_t kScratchFactor = 2;
/// "" or a sentence: `said` is at least `taken` and, for a `large` batch, at most kScratchFactor times as much.
std::string scratch_failure(std::size_t said, std::size_t taken, bool large);

/// layers() are sound, multiply_adds() is their sum and what compute/gemm.h counts while derive and forward run
/// (nothing is counted of a field that multiplies by itself); scratch_bytes() bounds what forward and backward take.
void check_costs(const Field<float>& field, const FieldBuild& build, const LawOptions& options, Failures& failures);

}  // namespace semfield::testkit
