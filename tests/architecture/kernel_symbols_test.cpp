// Kernel files are compiled once per instruction set. A function that such a file shares with others (an inline one
// that was not inlined, an instantiated template of the standard library) is kept once by the linker, perhaps the copy
// of an instruction set that the CPU lacks: the program would die on machines that no developer has.
#include <array>
#include <cstdio>
#include <fstream>
#include <sstream>

#include "core/text.h"
#include "tests/says.h"

namespace semfield {
namespace {

std::string output_of(const std::string& command) {
  std::string text;
  FILE* pipe = popen(command.c_str(), "r");
  std::array<char, 4096> buffer{};
  while (pipe != nullptr && std::fgets(buffer.data(), buffer.size(), pipe) != nullptr) text += buffer.data();
  EXPECT_TRUE(pipe != nullptr && pclose(pipe) == 0) << command;
  return text;
}

TEST(KernelSymbols, NoFunctionIsSharedBetweenInstructionSets) {
  std::ifstream list(SEMFIELD_BINARY_DIR "/generated/kernel_objects.txt");
  int objects = 0, symbols = 0;
  for (std::string object; std::getline(list, object);) {
    if (object.empty()) continue;
    ++objects;
    std::istringstream lines(output_of("nm --demangle --defined-only " + shell_word(object)));
    for (std::string line; std::getline(lines, line);) {
      // "0000000000000000 W name": W are shared functions, u shared variables (V, type descriptions, hold no code).
      if (line.size() < 20) continue;
      ++symbols;
      const char kind = line[17];
      if (kind != 'W' && kind != 'u') continue;
      EXPECT_HAS(line, "semfield::isa_") << object << " shares " << line.substr(19);
    }
  }
  EXPECT_GT(objects, 0);
  EXPECT_GT(symbols, objects);
}

}  // namespace
}  // namespace semfield
