// Checksums for files and hashes for names.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>

namespace semfield {

/// CRC-32C (Castagnoli, reflected 0x82F63B78) of `bytes`, continuing from `crc`.
std::uint32_t crc32c(std::span<const std::byte> bytes, std::uint32_t crc = 0);

/// 64-bit FNV-1a of a text: config and manifest fingerprints.
std::uint64_t fnv1a64(std::string_view text);

/// Fixed-width lower-case hexadecimal.
std::string hex64(std::uint64_t value);

}  // namespace semfield
