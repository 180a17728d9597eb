// G12: modules that a host must refuse, and live on.
#include <dlfcn.h>
#include <elf.h>

#include <cstring>
#include <stdexcept>

#include "input_parts.h"
#include "plugin/loader.h"
#include "system/files.h"
#include "tests/scene/room_files.h"

namespace semfield::numerics {

namespace {

struct NoParams {};
void describe(ParamVisitor&, NoParams&) {}
void validate(const NoParams&, Diagnostics&) {}
class Nothing final : public Dataset {
 public:
  Nothing(const NoParams&, const DatasetBuild&) {}
  SceneInfo open(Diagnostics&) override { return {}; }
  void read(int, FrameBuffer&) const override {}
};

void register_one(Registry& registry) { registry.add_dataset<Nothing, NoParams>("of_a_module", "A dataset."); }
void register_then_throw(Registry& registry) {
  register_one(registry);
  throw std::runtime_error("half way through");
}
void register_then_throw_a_number(Registry& registry) {
  register_one(registry);
  throw 7;  // NOLINT: what a module of someone else may do
}
void register_a_taken_name(Registry& registry) {
  registry.add_dataset<Nothing, NoParams>("before_the_taken", "Must not stay.");
  registry.add_dataset<Nothing, NoParams>("packed", "A name that is taken.");
}

// The file that holds this code: a shared library without a plugin in it.
std::string this_library() {
  Dl_info info{};
  return dladdr(reinterpret_cast<const void*>(&register_one), &info) != 0 && info.dli_fname != nullptr ? info.dli_fname
                                                                                                       : "";
}

}  // namespace

void broken_plugins(CaseRun& run) {
  run.row("-");
  Registry registry = run.registry();
  const std::size_t entries = registry.entries().size();
  const auto unchanged = [&] { run.expect(registry.entries().size() == entries, "the registry is as it was"); };
  const PluginModule sound{kPluginApi, abi_tag_of_framework(), "m", "1.0", register_one};
  const auto refused = [&](const auto& change, const std::vector<std::string>& words) {
    PluginModule module = sound;
    change(module);
    run.expect_error(ErrorKind::unavailable, words, [&] { register_module(registry, module); });
    unchanged();
  };
  const std::string ours = std::to_string(kPluginApi);
  for (const int api : {kPluginApi + 1, kPluginApi - 1, 0, -1, 999})
    refused([&](PluginModule& m) { m.api = api; }, {"API " + std::to_string(api) + ",", "speaks " + ours});
  refused([](PluginModule& m) { m.abi_tag = "libother-1"; }, {"'libother-1'", abi_tag_of_framework()});
  refused([](PluginModule& m) { m.abi_tag = nullptr; }, {"ABI ''", abi_tag_of_framework()});
  refused([](PluginModule& m) { m.name = nullptr; }, {"lacks its name"});
  refused([](PluginModule& m) { m.version = nullptr; }, {"lacks its name, version"});
  refused([](PluginModule& m) { m.register_into = nullptr; }, {"register function"});
  refused([](PluginModule& m) { m.register_into = register_then_throw; }, {"'m 1.0'", "half way through"});
  refused([](PluginModule& m) { m.register_into = register_then_throw_a_number; }, {"'m 1.0'", "an unknown exception"});
  if (run.registry().find(PluginKind::dataset, "packed") != nullptr) {
    refused([](PluginModule& m) { m.register_into = register_a_taken_name; }, {"'packed'", "m 1.0", "taken"});
    run.expect(registry.find(PluginKind::dataset, "before_the_taken") == nullptr, "nothing of it stays");
  }

  // Files. The library of this suite is whole and sound, and no plugin.
  const std::string path = run.folder() + "/module.so", library = this_library();
  const auto file_refused = [&](const std::string& file, const std::vector<std::string>& words) {
    std::vector<std::string> all = words;
    all.push_back("'" + file + "'");
    run.expect_error(ErrorKind::unavailable, all, [&] { load_module(registry, file); });
    unchanged();
  };
  file_refused(run.folder() + "/none.so", {"there is no such file"});
  file_refused(run.folder(), {"there is no such file"});
  file_refused(library, {"has no section '.semfield_plugin'"});
  testing_room::plain_write(path, "");
  file_refused(path, {});
  testing_room::plain_write(path, "plain text that is no library");
  file_refused(path, {});
  const std::string whole = read_text_file(library);
  std::string start = whole.substr(0, 4096);
  const auto with_machine = [&](unsigned machine) {
    std::string file = start;
    file[offsetof(Elf64_Ehdr, e_machine)] = static_cast<char>(machine);
    file[offsetof(Elf64_Ehdr, e_machine) + 1] = 0;
    testing_room::plain_write(path, file);
  };
  with_machine(183);  // AArch64
  file_refused(path, {"another CPU", "183"});
  std::string narrow = start;
  narrow[EI_CLASS] = ELFCLASS32;
  testing_room::plain_write(path, narrow);
  file_refused(path, {"another CPU"});
  // A copy that was interrupted: mapped beyond its end it would end the process.
  for (const std::size_t size :
       {std::size_t{20}, std::size_t{64}, std::size_t{500}, std::size_t{4096}, whole.size() / 2}) {
    testing_room::plain_write(path, whole.substr(0, size));
    file_refused(path, size >= 4096 ? std::vector<std::string>{"cut short"} : std::vector<std::string>{});
  }
  register_module(registry, sound);
  run.expect(registry.find(PluginKind::dataset, "of_a_module") != nullptr, "a sound module is still taken afterwards");
}

}  // namespace semfield::numerics
