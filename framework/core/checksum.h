// Checksums for files and hashes for names.
#pragma once

#include <array>
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

// SHA-256 [FIPS180]: what says that two runs gave the same bytes.

/// Fed in pieces; the digest does not depend on where they are cut.
class Sha256 {
 public:
  void add(std::span<const std::byte> bytes);
  /// 64 lower-case hexadecimal digits. Ends the sum: nothing may be added afterwards.
  std::string hex();

 private:
  void block(const std::byte* bytes);

  std::array<std::uint32_t, 8> state_{0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                                      0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
  std::array<std::byte, 64> rest_{};
  std::uint64_t size_ = 0;
};

/// Of a text.
std::string sha256_of(std::string_view text);

}  // namespace semfield
