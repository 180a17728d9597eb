#include "tests/fuzz/inputs.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <set>
#include <stdexcept>

#include "config/config_tree.h"
#include "config/params.h"
#include "formats/image_io.h"
#include "plugin/loader.h"

namespace semfield::fuzz {

namespace fs = std::filesystem;

namespace {

struct Folder {
  Folder() {
    const fs::path parent = fs::is_directory("/dev/shm") ? fs::path("/dev/shm") : fs::temp_directory_path();
    std::string name = (parent / "semfield_fuzz_XXXXXX").string();
    if (::mkdtemp(name.data()) == nullptr) throw std::runtime_error("no folder for the files of the fuzzer");
    path = name;
  }
  ~Folder() {
    std::error_code ignored;
    fs::remove_all(path, ignored);
  }
  std::string path;
};

}  // namespace

const std::string& folder() {
  static const Folder made;
  return made.path;
}

std::string put(const std::string& name, std::string_view bytes) {
  const fs::path path = fs::path(folder()) / name;
  std::FILE* file = std::fopen(path.c_str(), "wb");
  if (file == nullptr) {
    fs::create_directories(path.parent_path());
    file = std::fopen(path.c_str(), "wb");
  }
  if (file == nullptr || (!bytes.empty() && std::fwrite(bytes.data(), 1, bytes.size(), file) != bytes.size()))
    throw std::runtime_error("cannot write " + path.string());
  std::fclose(file);
  return path.string();
}

std::string put_image(const std::string& name, int width_px, int height_px) {
  static std::set<std::string> written;
  const std::string path = (fs::path(folder()) / name).string();
  if (!written.insert(name).second) return path;
  fs::create_directories(fs::path(path).parent_path());
  const std::vector<std::uint8_t> pixels(static_cast<std::size_t>(width_px) * static_cast<std::size_t>(height_px), 1);
  write_png_gray8(path, width_px, height_px, pixels);
  return path;
}

std::vector<std::string_view> parts_of(std::string_view bytes, std::size_t count) {
  constexpr std::string_view kCut = "=====\n";
  std::vector<std::string_view> out;
  while (out.size() + 1 < count) {
    const std::size_t at = bytes.find(kCut);
    if (at == std::string_view::npos) break;
    out.push_back(bytes.substr(0, at));
    bytes.remove_prefix(at + kCut.size());
  }
  out.push_back(bytes);
  out.resize(std::max(count, out.size()));
  return out;
}

bool accepted(const std::function<void()>& body) {
  try {
    body();
    return true;
  } catch (const Error& e) {
    if (e.kind() == ErrorKind::internal)
      throw std::logic_error(std::string("an input is no fault of ours: ") + e.what());
    if (e.message().empty()) throw std::logic_error("refused without a word");
    return false;
  }
}

void promise(bool holds, const char* what) {
  if (!holds) throw std::logic_error(what);
}

Registry& registry() {
  static Registry& made = []() -> Registry& {
    static Registry all;
    register_linked_plugins(all);
    return all;
  }();
  return made;
}

void open_dataset(const std::string& name, const std::string& yaml) {
  const PluginEntry& entry = registry().get(PluginKind::dataset, name);
  const std::unique_ptr<PluginParams> params = entry.new_params();
  Diagnostics settings;
  read_params(
      parse_config_text(yaml, "scene"), "scene", [&](ParamVisitor& visit) { params->describe(visit); }, settings);
  promise(!settings.has_errors(), "the parameters of the target itself are wrong");
  accepted([&] {
    const std::unique_ptr<Dataset> dataset = entry.dataset(*params, DatasetBuild{folder()});
    Diagnostics diagnostics;
    const SceneInfo info = dataset->open(diagnostics);
    for (const Diagnostic& d : diagnostics.all()) promise(!d.message.empty(), "a finding without a word");
    if (diagnostics.has_errors()) return;
    for (std::size_t i = 0; i < info.frames.size(); ++i) {
      const FrameInfo& frame = info.frames[i];
      promise(frame.camera.width_px > 0 && frame.camera.height_px > 0, "an accepted frame has no size");
      promise(frame.camera.fx > 0 && frame.camera.fy > 0, "an accepted frame has no focal length");
      for (int a = 0; a < 3; ++a) {
        promise(std::isfinite(frame.world_from_camera.t[a]), "an accepted pose is not finite");
        for (const double v : frame.world_from_camera.r[a])
          promise(std::abs(v) < 1.01, "an accepted pose has no rotation");
      }
      FrameBuffer buffer;
      accepted([&] { dataset->read(static_cast<int>(i), buffer); });
    }
  });
}

}  // namespace semfield::fuzz
