// plugins docs: the generated reference of plugins, on a page or in a whole source tree.
#include <filesystem>

#include "app/command_line/man_page.h"
#include "app/verb.h"
#include "app/verbs/plugins/plugin_output.h"
#include "plugin/reference.h"
#include "system/files.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

struct DocsOptions {
  std::string out;  ///< "" prints the page, a file receives it, a source tree (a folder with plugins/) has all its
                    ///< pages renewed
};

// The generated pages of a source tree: plugins.md and verbs.md in docs/reference, and the table in each plugin
// folder's README.
int refresh_tree(const fs::path& root, const AppContext& context) {
  int written = 0;
  const auto write_if_new = [&written](const fs::path& path, const std::string& text) {
    if (fs::exists(path) && read_text_file(path.string()) == text) return;
    write_file_atomic(path.string(), text);
    ++written;
  };
  fs::create_directories(root / "docs" / "reference");
  write_if_new(root / "docs" / "reference" / "plugins.md", plugins_markdown(context.registry));
  write_if_new(root / "docs" / "reference" / "verbs.md", verbs_page(program_grammar()));
  for (const PluginEntry* entry : context.registry.entries()) {
    for (const char* top : {"plugins", "framework"}) {
      const fs::path readme = root / top / kind_folder(entry->kind) / entry->name / "README.md";
      if (fs::exists(readme)) write_if_new(readme, with_parameter_table(read_text_file(readme.string()), *entry));
    }
  }
  print_note(context, std::to_string(written) + " generated pages changed under " + root.string());
  return 0;
}

int run(const DocsOptions& options, AppContext& context) {
  const std::string& out = options.out;
  if (!out.empty() && fs::is_directory(fs::path(out) / "plugins")) return refresh_tree(out, context);
  const std::string page = plugins_markdown(context.registry);
  if (out.empty()) {
    print_text(page);
  } else {
    write_file_atomic(out, page);
  }
  return 0;
}

void words(VerbWords& verb, DocsOptions& options) {
  verb.value("--out PATH", options.out, "file to write, or a source tree whose pages are renewed (default: stdout)");
}

}  // namespace

Verb verb_plugins_docs() { return make_verb<DocsOptions>("plugins docs", 30, "write the reference page", words, run); }

}  // namespace semfield::app
