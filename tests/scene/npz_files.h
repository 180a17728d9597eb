// Archives of NumPy arrays, as tests write them.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "core/half.h"
#include "formats/npz.h"
#include "formats/zip_archive.h"

namespace semfield {

/// An array to write; the values are rounded to float16.
struct NpzEntry {
  std::string key;
  std::vector<std::int64_t> shape;
  std::span<const float> values;
};

/// Deflated entries, no times: equal arrays give equal files.
inline void write_npz(const std::string& path, std::span<const NpzEntry> entries) {
  ZipWriter archive(path);
  for (const NpzEntry& entry : entries) {
    std::string bytes = npy_header("<f2", entry.shape);
    for (const float value : entry.values) {
      const std::uint16_t half = half_of(value);
      bytes += static_cast<char>(half & 0xFF);
      bytes += static_cast<char>(half >> 8);
    }
    archive.add(entry.key + ".npy", bytes);
  }
  archive.write();
}

}  // namespace semfield
