#include "tests/golden/golden_file.h"

#include <gnu/libc-version.h>

#include <cstdio>
#include <sstream>

#include "core/error.h"
#include "system/files.h"

namespace semfield::testing_golden {

namespace {

constexpr const char* kHead =
    "# CRC-32C of all parameters, moments and states after 20 steps on the processor. A row is a configuration of\n"
    "# tests/golden/golden_rows.cpp, a column an instruction set. A section holds for one compiler and one C library:\n"
    "# compilers contract different products and sums to fused multiply-adds, C libraries round exp and log "
    "differently.\n"
    "# avx512_bf16 also names the maker of the processor, since nothing promises that both round VDPBF16PS alike;\n"
    "# amx stands for both, the tile instructions and their emulation: their sums are the same bits.\n"
    "# A change that is meant to change numbers writes the section of its machine anew, and removes those it cannot "
    "write:\n"
    "# SEMFIELD_WRITE_GOLDEN=1 build/release/tests/golden/golden_test\n";

std::vector<std::string> words_of(const std::string& line) {
  std::istringstream stream(line);
  std::vector<std::string> words;
  for (std::string word; stream >> word;) words.push_back(word);
  return words;
}

}  // namespace

std::string toolchain() {
#if defined(__clang__)
  const std::string compiler = "clang " + std::to_string(__clang_major__);
#else
  const std::string compiler = "gcc " + std::to_string(__GNUC__);
#endif
  return compiler + ", glibc " + gnu_get_libc_version();
}

std::string column_name(const std::string& isa) {
#if defined(__x86_64__)
  if (isa == "amx_emulated" || isa == "amx_bf16") return "amx";
  if (isa == "avx512_bf16") {
    return isa + (__builtin_cpu_is("amd") ? "/amd" : __builtin_cpu_is("intel") ? "/intel" : "/other");
  }
#endif
  return isa;
}

std::map<std::string, Section> read_golden_file(const std::string& path) {
  std::map<std::string, Section> sections;
  std::istringstream text(read_text_file(path));
  std::string line;
  Section* section = nullptr;
  std::vector<std::string> isas;
  for (int number = 1; std::getline(text, line); ++number) {
    if (line.empty() || line[0] == '#') continue;
    if (line.front() == '[' && line.back() == ']') {
      section = &sections[line.substr(1, line.size() - 2)];
      isas.clear();
      continue;
    }
    const std::vector<std::string> words = words_of(line);
    if (section == nullptr || words.size() < 2 || (!isas.empty() && words.size() != isas.size() + 1)) {
      throw Error(ErrorKind::data, "test.error.made", path + ":" + std::to_string(number) + ": no row of golden values",
                  "write the section anew, as the head of the file says");
    }
    if (isas.empty()) {
      isas.assign(words.begin() + 1, words.end());
      continue;
    }
    for (std::size_t i = 0; i < isas.size(); ++i) (*section)[isas[i]].emplace_back(words[0], words[i + 1]);
  }
  return sections;
}

void write_golden_file(const std::string& path, const std::map<std::string, Section>& sections) {
  std::string text = kHead;
  const auto cell = [&text](const char* format, const std::string& word) {
    char buffer[64];
    std::snprintf(buffer, sizeof buffer, format, word.c_str());
    text += buffer;
  };
  for (const auto& [name, section] : sections) {
    text += "\n[" + name + "]\n";
    cell("%-32s", "configuration");
    for (const auto& [isa, column] : section) cell("  %-15s", isa);
    text += '\n';
    const Column& first = section.begin()->second;
    for (std::size_t row = 0; row < first.size(); ++row) {
      cell("%-32s", first[row].first);
      for (const auto& [isa, column] : section) cell("  %-15s", column.at(row).second);
      text += '\n';
    }
  }
  std::string trimmed;  // without blanks at the ends of lines
  for (const char c : text) {
    if (c == '\n') trimmed.erase(trimmed.find_last_not_of(' ') + 1);
    trimmed += c;
  }
  write_file_atomic(path, trimmed);
}

Column parse_column(const std::string& text) {
  Column column;
  std::istringstream stream(text);
  for (std::string name, value; stream >> name >> value;) column.emplace_back(name, value);
  return column;
}

}  // namespace semfield::testing_golden
