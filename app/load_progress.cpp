#include "load_progress.h"

#include <memory>
#include <string>

#include "progress_line.h"
#include "scene/load_progress.h"

namespace semfield::app {

void show_load_progress(const AppContext& context) {
  std::shared_ptr<ProgressLine> line;
  std::string shown;
  set_load_progress([&context, line, shown](std::string_view doing, std::size_t done, std::size_t total) mutable {
    if (doing == "read") return line.reset();
    const std::string what = "scene: " + std::string(doing);
    if (!line) {
      line = std::make_shared<ProgressLine>(context, what);
    } else if (what != shown) {
      line->restart(what);
    }
    shown = what;
    line->show(static_cast<double>(done), static_cast<double>(total));
  });
}

}  // namespace semfield::app
