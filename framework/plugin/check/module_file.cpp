// The ELF file of a loadable module: processor, length, and the stamp in its own section.
#include "plugin/check/module_file.h"

#include <elf.h>
#include <fmt/format.h>
#include <link.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <string_view>

#include "plugin/module.h"
#include "system/checksum.h"
#include "system/files.h"

namespace semfield {

namespace {

constexpr std::size_t kMostSections = 65535, kMostNames = std::size_t{1} << 24;

// Pieces of the file by offset; a piece that is not all there counts as none.
class ModuleFile {
 public:
  ModuleFile(const std::string& path, std::string doing)
      : doing_(std::move(doing)), file_(path, std::ios::binary), size_(std::filesystem::file_size(path)) {
    if (!file_) refuse("plugin.module.unreadable", "it cannot be opened", "check its permissions");
  }

  [[noreturn]] void refuse(Code code, const std::string& why, const std::string& remedy) const {
    throw Error(ErrorKind::unavailable, code, doing_ + ": " + why, remedy);
  }
  void require(std::uint64_t end) const {
    if (end > size_)
      refuse("plugin.module.damaged",
             "the file is cut short: it ends at byte " + std::to_string(size_) + " of " + std::to_string(end),
             "copy or build it again");
  }
  template <class T>
  T at(std::uint64_t offset) {
    T value{};
    read(offset, &value, sizeof value);
    return value;
  }
  void read(std::uint64_t offset, void* out, std::size_t bytes) {
    if (offset > size_ || bytes > size_ - offset) require(offset > ~bytes ? ~std::uint64_t{0} : offset + bytes);
    file_.seekg(static_cast<std::streamoff>(offset));
    file_.read(static_cast<char*>(out), static_cast<std::streamsize>(bytes));
    if (!file_) refuse("plugin.module.unreadable", "it cannot be read", "check the disk");
  }
  std::uint64_t size() const { return size_; }

 private:
  std::string doing_;
  std::ifstream file_;
  std::uint64_t size_;
};

void check_processor(const ModuleFile& file, const ElfW(Ehdr) & header) {
  ElfW(Ehdr) own{};
  std::ifstream program("/proc/self/exe", std::ios::binary);
  if (!program.read(reinterpret_cast<char*>(&own), sizeof own)) return;
  if (header.e_ident[EI_CLASS] == own.e_ident[EI_CLASS] && header.e_ident[EI_DATA] == own.e_ident[EI_DATA] &&
      header.e_machine == own.e_machine)
    return;
  file.refuse("plugin.module.processor",
              "it was built for another CPU (ELF class " + std::to_string(header.e_ident[EI_CLASS]) + ", machine " +
                  std::to_string(header.e_machine) + "; this program: " + std::to_string(own.e_ident[EI_CLASS]) + ", " +
                  std::to_string(own.e_machine) + ")",
              "build it on this kind of machine");
}

// A copy that was interrupted would end the program at the first touch of a page that is not there.
void check_length(ModuleFile& file, const ElfW(Ehdr) & header) {
  for (std::size_t i = 0; i < header.e_phnum; ++i) {
    const auto part = file.at<ElfW(Phdr)>(header.e_phoff + i * sizeof(ElfW(Phdr)));
    if (part.p_type == PT_LOAD) file.require(part.p_offset + part.p_filesz);
  }
  file.require(header.e_shoff + std::uint64_t{header.e_shnum} * sizeof(ElfW(Shdr)));
}

PluginStamp stamp_of(ModuleFile& file, const ElfW(Ehdr) & header) {
  const auto section = [&](std::size_t i) { return file.at<ElfW(Shdr)>(header.e_shoff + i * sizeof(ElfW(Shdr))); };
  if (header.e_shoff != 0 && header.e_shstrndx < header.e_shnum && header.e_shnum <= kMostSections) {
    const ElfW(Shdr) about_names = section(header.e_shstrndx);
    std::string names(std::min<std::size_t>(about_names.sh_size, kMostNames), '\0');
    file.read(about_names.sh_offset, names.data(), names.size());
    for (std::size_t i = 0; i < header.e_shnum; ++i) {
      const ElfW(Shdr) s = section(i);
      if (s.sh_name >= names.size() || names.c_str() + s.sh_name != std::string_view(kPluginSection)) continue;
      if (s.sh_type != SHT_PROGBITS || s.sh_size < sizeof(PluginStamp)) break;
      return file.at<PluginStamp>(s.sh_offset);
    }
  }
  file.refuse("plugin.module.foreign",
              std::string("it has no section '") + kPluginSection +
                  "', so it is not a plugin, or it was built before modules had one",
              "build it with SEMFIELD_LOADABLE_MODULE defined and end it with SEMFIELD_PLUGIN_MODULE(...)");
}

}  // namespace

void check_module_file(const std::string& path, const std::string& doing) {
  ModuleFile file(path, doing);
  if (file.size() < SELFMAG || std::memcmp(file.at<std::array<char, SELFMAG>>(0).data(), ELFMAG, SELFMAG) != 0)
    file.refuse("plugin.module.foreign", "it is not a shared library", "check that it is the right file");
  const auto header = file.at<ElfW(Ehdr)>(0);
  check_processor(file, header);
  if (header.e_type != ET_DYN)
    file.refuse("plugin.module.foreign", "it is not a shared library", "check that it is the right file");
  check_length(file, header);
  const PluginStamp stamp = stamp_of(file, header);
  const PluginStamp ours{};
  if (std::memcmp(stamp.magic, ours.magic, sizeof ours.magic) != 0)
    file.refuse("plugin.module.foreign", std::string("its section '") + kPluginSection + "' holds something else",
                "end the plugin with SEMFIELD_PLUGIN_MODULE(name, version, function)");
  const std::string tag(stamp.abi_tag, strnlen(stamp.abi_tag, sizeof stamp.abi_tag));
  try {
    check_interface(stamp.api, tag);
  } catch (Error& error) {
    throw error.while_doing(doing);
  }
}

std::map<std::string, std::string> module_checksums(const std::vector<std::string>& files) {
  std::map<std::string, std::string> checksums;
  for (const std::string& file : files) {
    const std::string bytes = read_text_file(file, std::size_t{1} << 32);
    checksums[std::filesystem::path(file).filename().string()] =
        fmt::format("{:08x}, {} bytes", crc32c(std::as_bytes(std::span(bytes))), bytes.size());
  }
  return checksums;
}

void warn_of_other_modules(const std::map<std::string, std::string>& trained, const std::vector<std::string>& files,
                           Diagnostics& diagnostics) {
  for (const auto& [name, checksum] : module_checksums(files)) {
    const auto before = trained.find(name);
    if (before == trained.end() || before->second == checksum) continue;
    diagnostics.warning("plugin.module.changed", name,
                        fmt::format("the file of this plugin is not the one that the run was trained with: its "
                                    "CRC-32C is {} where it was {}; results may differ",
                                    checksum, before->second),
                        "load the file that it was trained with, or train again");
  }
}

}  // namespace semfield
