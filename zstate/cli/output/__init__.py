"""What commands write: text, tables, trees and pictures."""
