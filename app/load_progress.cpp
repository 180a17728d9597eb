#include "app/load_progress.h"

#include <memory>
#include <string>

#include "app/terminal.h"

namespace semfield::app {

void show_load_progress(AppContext& context) {
  std::shared_ptr<ProgressLine> line;
  std::string shown;
  context.load_progress = [&context, line, shown](std::string_view doing, std::size_t done, std::size_t total) mutable {
    if (doing == "read") return line.reset();
    const std::string what = "scene: " + std::string(doing);
    if (!line) {
      line = std::make_shared<ProgressLine>(context, what);
    } else if (what != shown) {
      line->restart(what);
    }
    shown = what;
    line->show(static_cast<double>(done), static_cast<double>(total));
  };
  context.work.load_progress = &context.load_progress;
}

}  // namespace semfield::app
