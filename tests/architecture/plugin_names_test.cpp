// Framework and program name no plugin: what a plugin is and takes comes from its interface.
#include <gtest/gtest.h>

#include <algorithm>
#include <cctype>
#include <set>

#include "plugin/linked_plugins.h"
#include "plugin/registry.h"
#include "tests/architecture/include_rules.h"

namespace semfield::architecture {
namespace {

// English words too: they count where they stand for the plugin, as the whole of a text or behind `type:`.
const std::set<std::string> kWords{"frequency", "identity", "importance", "packed", "propagation", "stratified"};

// COLMAP is a program too, which these run, and whose files they read.
bool means_the_program(const std::string& file, const std::string& plugin) {
  return plugin == "colmap" &&
         (file.starts_with("framework/loading/capture/") || file.starts_with("framework/loading/colmap_"));
}

bool part_of_name(char c) { return std::isalnum(static_cast<unsigned char>(c)) != 0 || c == '_'; }

bool stands_alone(const std::string& text, std::size_t at, std::size_t size) {
  return (at == 0 || !part_of_name(text[at - 1])) && (at + size == text.size() || !part_of_name(text[at + size]));
}

bool quoted(const std::string& text, std::size_t at, std::size_t size) {
  const char before = at == 0 ? ' ' : text[at - 1], after = at + size == text.size() ? ' ' : text[at + size];
  return (before == '"' || before == '\'') && after == before;
}

bool behind_type(const std::string& text, std::size_t at) {
  while (at > 0 && text[at - 1] == ' ') --at;
  return at >= 5 && (text.compare(at - 5, 5, "type:") == 0 || text.compare(at - 5, 5, "type=") == 0);
}

/// The class's name: nerf_mlp, NerfMlp.
std::string class_of(const std::string& name) {
  std::string out;
  for (std::size_t i = 0; i < name.size(); ++i) {
    if (name[i] == '_') continue;
    const bool first = i == 0 || name[i - 1] == '_';
    out += first ? static_cast<char>(std::toupper(static_cast<unsigned char>(name[i]))) : name[i];
  }
  return out;
}

/// Lines of `text` that name the plugin.
std::vector<int> lines_naming(const std::string& text, const std::string& plugin) {
  std::vector<int> lines;
  const auto look_for = [&](const std::string& name, const auto& counts) {
    for (std::size_t at = text.find(name); at != std::string::npos; at = text.find(name, at + 1)) {
      if (stands_alone(text, at, name.size()) && counts(at))
        lines.push_back(
            static_cast<int>(std::count(text.begin(), text.begin() + static_cast<std::ptrdiff_t>(at), '\n')) + 1);
    }
  };
  const bool word = kWords.contains(plugin);
  look_for(plugin, [&](std::size_t at) { return !word || quoted(text, at, plugin.size()) || behind_type(text, at); });
  if (plugin.find('_') != std::string::npos) look_for(class_of(plugin), [](std::size_t) { return true; });
  return lines;
}

TEST(PluginNames, FrameworkAndProgramNameNoPlugin) {
  Registry registry;
  register_linked_plugins(registry);
  ASSERT_GT(registry.entries().size(), 8u);
  std::vector<SourceFile> files;
  for (const char* folder : {"framework", "app"}) {
    for (SourceFile& file : files_under(folder, {".h", ".cpp", ".cu", ".cuh"})) files.push_back(std::move(file));
  }
  ASSERT_GT(files.size(), 200u);
  for (const SourceFile& file : files) {
    for (const PluginEntry* entry : registry.entries()) {
      const std::string own = "framework/" + std::string(kind_folder(entry->kind)) + "/" + entry->name;
      if (!files_under(own, {".cpp"}).empty()) continue;      // it comes with the framework
      if (entry->kind == PluginKind::label_reader) continue;  // named as the file format, which others write
      if (means_the_program(file.path, entry->name)) continue;
      for (const int line : lines_naming(file.text, entry->name)) {
        ADD_FAILURE() << file.path << ':' << line << " names the " << kind_name(entry->kind) << " '" << entry->name
                      << '\'';
      }
    }
  }
}

TEST(PluginNames, ANameIsFoundInTextsCommentsAndClasses) {
  EXPECT_EQ(lines_naming("a\nb \"tiny_mlp\" c", "tiny_mlp"), std::vector<int>{2});
  EXPECT_EQ(lines_naming("// fitted to tiny_mlp, TinyMlp", "tiny_mlp").size(), 2u);
  EXPECT_EQ(lines_naming("my_tiny_mlps, tiny_mlp_x", "tiny_mlp").size(), 0u);
  EXPECT_EQ(lines_naming("{type: packed} 'packed' \"packed\" type=packed", "packed").size(), 4u);
  EXPECT_EQ(lines_naming("rows are packed; packed(x)", "packed").size(), 0u);
}

}  // namespace
}  // namespace semfield::architecture
