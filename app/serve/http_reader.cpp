#include "app/serve/http_reader.h"

#include <algorithm>
#include <charconv>
#include <string>
#include <string_view>
#include <system_error>
#include <vector>

#include "core/text.h"

namespace semfield::app {

namespace {

constexpr std::size_t kMostHeadBytes = 16384;
constexpr std::string_view kLineEnd = "\r\n";

// The characters of a method or a header's name.
bool is_token(std::string_view text) {
  return !text.empty() && std::all_of(text.begin(), text.end(), [](char c) {
    return is_alnum(c) || std::string_view("!#$%&'*+-.^_`|~").find(c) != std::string_view::npos;
  });
}

bool is_visible(char c) { return static_cast<unsigned char>(c) > 0x20 && c != 0x7F; }
bool is_text(char c) { return is_visible(c) || c == ' ' || c == '\t'; }

std::string_view trimmed(std::string_view text) {
  while (!text.empty() && (text.front() == ' ' || text.front() == '\t')) text.remove_prefix(1);
  while (!text.empty() && (text.back() == ' ' || text.back() == '\t')) text.remove_suffix(1);
  return text;
}

bool has_word(std::string_view list, std::string_view word) {
  const std::vector<std::string_view> items = parts_of(list, ',');
  return std::any_of(items.begin(), items.end(),
                     [&](std::string_view item) { return lower_case(std::string(trimmed(item))) == word; });
}

}  // namespace

std::optional<std::string> HttpRequest::header(const std::string& name) const {
  for (const auto& [key, value] : headers) {
    if (key == name) return value;
  }
  return std::nullopt;
}

int HttpRequest::header_count(const std::string& name) const {
  return static_cast<int>(
      std::count_if(headers.begin(), headers.end(), [&](const auto& h) { return h.first == name; }));
}

namespace {

[[noreturn]] void refuse(int status, const char* complaint) { throw HttpRefusal{status, complaint}; }

}  // namespace

HttpRequest HttpReader::read_head() {
  is_head_ = false;
  std::size_t end = std::string::npos;
  for (;;) {
    while (unread_.starts_with(kLineEnd)) unread_.erase(0, kLineEnd.size());  // between requests
    end = unread_.find("\r\n\r\n");
    const std::size_t bare = unread_.find("\n\n"), ends = std::min(end, bare);
    if (ends == std::string::npos ? unread_.size() > kMostHeadBytes + 3 : ends > kMostHeadBytes)
      refuse(400, "the head of the request is too long");
    if (bare < end) refuse(400, "a line of the head does not end as lines of HTTP do");
    if (end != std::string::npos) break;
    more_(unread_);
  }
  HttpRequest request;
  const std::string head = unread_.substr(0, end + kLineEnd.size());
  unread_.erase(0, end + 2 * kLineEnd.size());
  parse_head(head, request);
  read_framing(request);
  return request;
}

void HttpReader::parse_head(std::string_view head, HttpRequest& request) {
  const auto line = [&] {
    const std::string_view text = head.substr(0, head.find(kLineEnd));
    head.remove_prefix(text.size() + kLineEnd.size());
    return text;
  };
  const std::string_view first = line();
  const std::size_t method = first.find(' '), version = first.rfind(' ');
  if (method == std::string_view::npos || version == method) refuse(400, "the request has no address");
  const std::string_view target = first.substr(method + 1, version - method - 1), http = first.substr(version + 1);
  if (!is_token(first.substr(0, method)) || target.empty() || !std::all_of(target.begin(), target.end(), is_visible))
    refuse(400, "the first line of the request cannot be read");
  if (http != "HTTP/1.1" && http != "HTTP/1.0") refuse(400, "the request is not of HTTP/1.1");
  keeps_ = http == "HTTP/1.1";
  request.method = first.substr(0, method);
  is_head_ = request.method == "HEAD";
  request.path = target.substr(0, target.find('?'));
  if (request.path.size() < target.size()) request.query = target.substr(request.path.size() + 1);
  while (!head.empty()) {
    const std::string_view text = line();
    const std::size_t colon = text.find(':');
    if (colon == std::string_view::npos || !is_token(text.substr(0, colon)) ||
        !std::all_of(text.begin(), text.end(), is_text))
      refuse(400, "a header of the request cannot be read");
    request.headers.emplace_back(lower_case(std::string(text.substr(0, colon))), trimmed(text.substr(colon + 1)));
  }
}

void HttpReader::read_framing(const HttpRequest& request) {
  const auto lengths = request.header_count("content-length"), codings = request.header_count("transfer-encoding");
  if (lengths + codings > 1) refuse(400, "the request has two lengths");
  for (const auto& [name, value] : request.headers)
    if (name == "connection" && has_word(value, "close")) keeps_ = false;
  expects_continue_ = lower_case(request.header("expect").value_or("")) == "100-continue";
  if (codings > 0) refuse(411, "a body needs its length: Content-Length");
  length_ = 0;
  if (lengths > 0) {
    const std::string text = *request.header("content-length");
    if (text.empty() || text.find_first_not_of("0123456789") != std::string::npos)
      refuse(400, "Content-Length is not a number of bytes");
    const auto [end, cause] = std::from_chars(text.data(), text.data() + text.size(), length_);
    if (cause != std::errc() || length_ > most_body_bytes_) refuse(413, "the body is too large");
  }
  whole_ = length_ == 0;
}

void HttpReader::read_body(HttpRequest& request) {
  while (unread_.size() < length_) more_(unread_);
  request.body = unread_.substr(0, length_);
  unread_.erase(0, length_);
  whole_ = true;
}

}  // namespace semfield::app
