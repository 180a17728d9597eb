#include "labels/run_lengths.h"

#include <algorithm>

namespace semfield {

namespace {

[[noreturn]] void refuse(const std::string& message) {
  throw Error(ErrorKind::data, "labels.run_lengths.damaged", "run lengths: " + message, "export the annotation again");
}

}  // namespace

std::vector<std::int64_t> counts_of_text(std::string_view text) {
  std::vector<std::int64_t> counts;
  for (std::size_t at = 0; at < text.size();) {
    std::uint64_t value = 0;
    for (int shift = 0;; shift += 5) {
      if (at == text.size()) refuse("the text ends within a number");
      if (shift > 35) refuse("number " + std::to_string(counts.size() + 1) + " is too large");
      const char c = text[at++];
      if (c < '0' || c > 'o') refuse("character " + std::to_string(at) + " does not belong to such a text");
      const auto bits = static_cast<std::uint64_t>(c - '0');
      value |= (bits & 0x1F) << shift;
      if ((bits & 0x20) != 0) continue;
      if ((bits & 0x10) != 0) value |= ~std::uint64_t{0} << (shift + 5);
      break;
    }
    auto count = static_cast<std::int64_t>(value);
    if (counts.size() > 2) count += counts[counts.size() - 2];
    if (count < 0) refuse("count " + std::to_string(counts.size() + 1) + " is negative");
    counts.push_back(count);
  }
  return counts;
}

std::string text_of_counts(const std::vector<std::int64_t>& counts) {
  std::string text;
  for (std::size_t i = 0; i < counts.size(); ++i) {
    std::int64_t value = counts[i] - (i > 2 ? counts[i - 2] : 0);
    for (bool more = true; more;) {
      std::int64_t bits = value & 0x1F;
      value >>= 5;
      more = (bits & 0x10) != 0 ? value != -1 : value != 0;
      if (more) bits |= 0x20;
      text += static_cast<char>('0' + bits);
    }
  }
  return text;
}

std::vector<PixelRun> runs_of_counts(const std::vector<std::int64_t>& counts, std::int32_t width, std::int32_t height) {
  const std::int64_t pixels = std::int64_t{width} * height;
  std::int64_t sum = 0;
  for (const std::int64_t count : counts) {
    if (count < 0 || count > pixels - sum) {
      refuse(count < 0
                 ? "a count is negative"
                 : "they run past the end of an image of " + std::to_string(width) + " x " + std::to_string(height));
    }
    sum += count;
  }
  if (sum != pixels) {
    refuse("they cover " + std::to_string(sum) + " of " + std::to_string(pixels) + " pixels of an image of " +
           std::to_string(width) + " x " + std::to_string(height));
  }
  std::vector<char> mask(static_cast<std::size_t>(pixels));
  std::int64_t at = 0;
  bool inside = false;
  for (const std::int64_t count : counts) {
    for (const std::int64_t end = at + count; inside && at < end; ++at)
      mask[static_cast<std::size_t>(at % height * width + at / height)] = 1;
    if (!inside) at += count;
    inside = !inside;
  }
  std::vector<PixelRun> runs;
  for (std::int32_t y = 0; y < height; ++y) {
    const auto row = mask.begin() + std::int64_t{y} * width, end = row + width;
    for (auto x0 = std::find(row, end, 1); x0 != end;) {
      const auto x1 = std::find(x0, end, 0);
      runs.push_back({y, static_cast<std::int32_t>(x0 - row), static_cast<std::int32_t>(x1 - row)});
      x0 = std::find(x1, end, 1);
    }
  }
  return runs;
}

std::vector<std::int64_t> counts_of_class(const std::vector<std::int16_t>& label, std::int16_t index,
                                          std::int32_t width, std::int32_t height) {
  std::vector<std::int64_t> counts{0};
  bool inside = false;
  for (std::int32_t x = 0; x < width; ++x) {
    for (std::int32_t y = 0; y < height; ++y) {
      const bool here = label[static_cast<std::size_t>(std::int64_t{y} * width + x)] == index;
      if (here != inside) counts.push_back(0);
      inside = here;
      ++counts.back();
    }
  }
  return counts;
}

}  // namespace semfield
