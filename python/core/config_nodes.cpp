#include "python/core/config_nodes.h"

#include <cstdlib>

#include "config/params_read.h"
#include "core/error.h"

namespace semfield::python {

namespace {

std::string place_of(const std::string& origin, const std::string& key) {
  return key.empty() ? origin : origin + ": " + key;
}

ConfigNode node_at(const py::handle& value, const Location& where, const std::string& key) {
  const auto scalar = [&](std::string text, bool quoted) {
    return ConfigNode::make_scalar(std::move(text), quoted, where);
  };
  if (value.is_none()) return ConfigNode::make_null(where);
  if (py::isinstance<py::bool_>(value)) return scalar(value.cast<bool>() ? "true" : "false", false);
  if (py::isinstance<py::str>(value)) {
    auto text = value.cast<std::string>();
    // Plain where plain YAML would be the same text: a message then shows it as a file would write it.
    const bool quoted = text.empty() || looks_typed(text);
    return scalar(std::move(text), quoted);
  }
  if (py::hasattr(value, "keys")) {
    std::vector<ConfigNode::Entry> entries;
    for (const auto& [name, item] : py::dict(py::reinterpret_borrow<py::object>(value))) {
      if (!py::isinstance<py::str>(name))
        throw Error(ErrorKind::usage, "config.key.type",
                    place_of(where.file, key) + ": a key is not text: " + py::repr(name).cast<std::string>());
      const auto word = name.cast<std::string>();
      entries.emplace_back(word, node_at(item, where, key.empty() ? word : key + "." + word));
    }
    return ConfigNode::make_map(std::move(entries), where);
  }
  if (py::isinstance<py::list>(value) || py::isinstance<py::tuple>(value)) {
    std::vector<ConfigNode> items;
    for (const py::handle item : value) items.push_back(node_at(item, where, key + "." + std::to_string(items.size())));
    return ConfigNode::make_list(std::move(items), where);
  }
  if (py::hasattr(value, "tolist")) return node_at(value.attr("tolist")(), where, key);  // arrays, and their numbers
  if (PyIndex_Check(value.ptr()) != 0) {
    const py::object whole = py::reinterpret_steal<py::object>(PyNumber_Index(value.ptr()));
    if (!whole) throw py::error_already_set();
    return scalar(py::str(whole).cast<std::string>(), false);
  }
  if (PyFloat_Check(value.ptr()) || py::hasattr(value, "__float__"))
    return scalar(shortest_number(value.cast<double>()), false);
  if (py::hasattr(value, "__fspath__")) return scalar(py::str(value.attr("__fspath__")()).cast<std::string>(), true);
  throw Error(ErrorKind::usage, "config.value.type",
              place_of(where.file, key) + ": " + py::repr(value.get_type()).cast<std::string>() +
                  " is not a value of a configuration",
              "give text, numbers, truth values, lists, dicts or paths");
}

py::object scalar_of(const ConfigNode& node) {
  const std::string& text = node.text();
  if (node.quoted() || !looks_typed(text)) return py::str(text);
  if (text == "true" || text == "false") return py::bool_(text == "true");
  const py::module_ builtins = py::module_::import("builtins");
  for (const char* type : {"int", "float"}) {
    try {
      return builtins.attr(type)(text);
    } catch (py::error_already_set& error) {
      if (!error.matches(PyExc_ValueError)) throw;
    }
  }
  return py::str(text);
}

}  // namespace

ConfigNode node_of(const py::handle& value, const std::string& origin) { return node_at(value, {origin, 0, 0}, ""); }

py::object object_of(const ConfigNode& node) {
  switch (node.kind()) {
    case ConfigNode::Kind::null:
      return py::none();
    case ConfigNode::Kind::scalar:
      return scalar_of(node);
    case ConfigNode::Kind::list: {
      py::list out;
      for (const ConfigNode& item : node.items()) out.append(object_of(item));
      return out;
    }
    case ConfigNode::Kind::map:
      break;
  }
  py::dict out;
  for (const auto& [name, item] : node.entries()) out[py::str(name)] = object_of(item);
  return out;
}

std::vector<ConfigOverride> overrides_of(const py::dict& set) {
  std::vector<ConfigOverride> out;
  for (const auto& [key, value] : set) {
    const auto name = py::str(key).cast<std::string>();
    out.push_back({name, node_of(value, "set[\"" + name + "\"]")});
  }
  return out;
}

ConfigNode with_scene(const ConfigNode& tree, const py::dict& scene) {
  const ConfigNode given = node_of(scene, "the scene");
  ConfigNode own = ConfigNode::make_map({}, given.location());
  if (const ConfigNode* before = tree.find("scene"); before != nullptr) {
    for (const char* stays : {"labels", "load"})
      if (const ConfigNode* section = before->find(stays); section != nullptr) own = own.with(stays, *section);
  }
  return tree.with("scene", merge_config(own, given));
}

ConfigNode composed(const py::object& config, const py::dict& set) {
  const std::vector<ConfigOverride> overrides = overrides_of(set);
  if (py::isinstance<py::dict>(config)) return compose_config_tree(node_of(config, "the dict"), overrides);
  return compose_config_with(py::str(config).cast<std::string>(), overrides);
}

}  // namespace semfield::python
