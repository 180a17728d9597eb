// An entry a file: FOLDER/CRC-SIZE-VERSION.
#include "system/file_verdicts.h"

#include <cstdio>
#include <filesystem>
#include <span>
#include <string_view>

#include "system/cache_folder.h"
#include "system/checksum.h"
#include "system/files.h"

namespace semfield {

namespace {

constexpr std::string_view kHead = "semfield-verdict-1\n";
constexpr std::size_t kMostBytes = std::size_t{1} << 32;  // of a file that is checked

std::string hex32(std::uint32_t value) { return hex64(value).substr(8); }

std::uint32_t crc_of(std::string_view text) { return crc32c(std::as_bytes(std::span(text.data(), text.size()))); }

// "" where there is no cache.
std::string entry_of(const std::string& file, const std::string& version) {
  const std::string folder = cache_folder("checks");
  if (folder.empty()) return "";
  const std::string bytes = read_text_file(file, kMostBytes);
  return folder + "/" + hex32(crc_of(bytes)) + "-" + std::to_string(bytes.size()) + "-" + version;
}

}  // namespace

std::optional<FileVerdict> read_verdict(const std::string& file, const std::string& version, Diagnostics& notes) {
  try {
    const std::string entry = entry_of(file, version);
    std::error_code ignored;
    if (entry.empty() || !std::filesystem::exists(entry, ignored)) return std::nullopt;
    // Head, fault, checksum of both: a line each, a fault may have several.
    const std::string text = read_text_file(entry, std::size_t{1} << 20);
    constexpr std::size_t kTail = 9;  // of eight digits and a line's end
    const std::string_view all(text);
    if (all.size() > kHead.size() + kTail && all.starts_with(kHead)) {
      const std::string_view rest = all.substr(0, all.size() - kTail);
      if (all.substr(rest.size()) == hex32(crc_of(rest)) + "\n" && rest.ends_with('\n'))
        return FileVerdict{std::string(rest.substr(kHead.size(), rest.size() - kHead.size() - 1)), entry};
    }
    notes.note("files.verdict.lost", file,
               "what a check found out about it is damaged in '" + entry + "' and is not used");
  } catch (const Error& error) {
    notes.note("files.verdict.lost", file, "whether it was checked cannot be read: " + error.message());
  }
  return std::nullopt;
}

void keep_verdict(const std::string& file, const std::string& version, const std::string& fault, Diagnostics& notes) {
  try {
    const std::string entry = entry_of(file, version);
    if (entry.empty()) {
      notes.note("files.verdict.lost", file, "there is no folder for caches, so what the check found is not kept");
      return;
    }
    const std::string text = std::string(kHead) + fault + "\n";
    write_file_atomic(entry, text + hex32(crc_of(text)) + "\n");
  } catch (const Error& error) {
    notes.note("files.verdict.lost", file, "what the check found is not kept: " + error.message());
  }
}

}  // namespace semfield
