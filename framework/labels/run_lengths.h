// COCO's run lengths of a mask [Lin14]: column by column from the top left, beginning with the pixels outside.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "labels/outline_fill.h"

namespace semfield {

/// Counts of a text, 5 bits a character from '0' on, low bits first: 0x20 marks that more follow, 0x10 of the last one
/// the sign; from the fourth count on differences to the count two before. Throws Error(data) with the cause for a
/// character out of range, a text that ends within a number, and a negative count.
std::vector<std::int64_t> counts_of_text(std::string_view text);
std::string text_of_counts(const std::vector<std::int64_t>& counts);

/// Pixels of the mask as runs of rows, rows ascending. Throws Error(data) for a negative count and for counts that do
/// not add up to width * height - before anything of that size is allocated.
std::vector<PixelRun> runs_of_counts(const std::vector<std::int64_t>& counts, std::int32_t width, std::int32_t height);

/// Counts of the pixels of `label` [height * width] that equal `index`.
std::vector<std::int64_t> counts_of_class(const std::vector<std::int16_t>& label, std::int16_t index,
                                          std::int32_t width, std::int32_t height);

}  // namespace semfield
